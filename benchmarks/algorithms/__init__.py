"""Algorithms on problems drawn at random: orders of subspace models, rotated test functions."""
