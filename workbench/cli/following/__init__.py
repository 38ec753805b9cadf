"""The online estimator over a record, and over one that is still being written."""
