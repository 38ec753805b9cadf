"""The online estimator as an FMU: a Python slave, and its native twin in C."""
