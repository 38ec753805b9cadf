"""A user's FMU with the effect that rides outside it as one FMU in C."""
