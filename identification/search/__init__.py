"""Multilevel coordinate search (thesis 3.7)."""
