"""Balances of a joint: which there are, their rows by the weak form, noise and floors."""
