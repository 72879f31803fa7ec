"""What sweeps say of each other: which look at which, and whether a place was occupied or seen through."""
