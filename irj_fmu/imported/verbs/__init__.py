"""Explore and track with a user's FMU as the model: what builds on its fit and its diagnosis."""
