"""FMUs of joints: plants, estimators, hosts, studies, and somebody else's FMU as a model."""
