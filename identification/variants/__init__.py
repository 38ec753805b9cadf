"""Variants of a joint's model: which effects to put in, held against each other on records."""
