"""Equations as text, LaTeX and sympy; laws typed as text; the effect library as a page."""
