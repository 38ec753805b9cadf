"""Records: files read, columns and units, the joint file, the gate before every fit."""
