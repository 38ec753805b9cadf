"""The gate before every fit: one module a kind of check, `gate` runs them all."""
