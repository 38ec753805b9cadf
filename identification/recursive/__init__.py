"""Recursive least squares with a U-D factor (thesis 3.2, 3.5)."""
