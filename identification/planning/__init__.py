"""Trajectory selection: which motion makes which parameter identifiable (thesis 3.8)."""
