"""Tables 4.2 to 4.6 and figures 3.12 to 3.16 and 4.16 to 4.47 of the thesis, once more on
simulated data.
"""
