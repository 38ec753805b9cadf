"""Somebody else's FMU as the model of a joint."""
