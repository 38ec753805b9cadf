"""Variants of a joint model, screened and fitted, and how near the screened errors are."""
