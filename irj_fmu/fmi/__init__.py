"""What every FMU is made of: variables, descriptions, archives, compilers, slaves, systems."""
