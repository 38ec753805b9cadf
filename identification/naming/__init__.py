"""Names of one missing effect held against each other: whole fits, sets, and how sure a name is."""
