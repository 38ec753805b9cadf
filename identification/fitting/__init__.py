"""Fits of a joint model: weak form and output error, standard errors, the error of a fit."""
