"""Plants as FMUs: CasADi functions compiled, joints with sensors and faults, reference joints."""
