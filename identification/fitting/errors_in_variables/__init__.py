"""A fit and its bands without what noise of the measured signals does to them."""
