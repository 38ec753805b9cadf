"""What the plots of the page ask for."""
