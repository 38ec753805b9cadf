"""Linear models without physics: subspace identification, black boxes, frequency responses."""
