"""The effect library: one file per physical effect; importing a file registers its effect."""
