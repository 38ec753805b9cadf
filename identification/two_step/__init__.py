"""Two-step identification: linear parameters by least squares, the others by a search (thesis
3.6).
"""
