"""Shapes of friction and stiffness laws, searched while an online estimator runs."""
