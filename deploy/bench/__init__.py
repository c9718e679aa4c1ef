"""Studies of many flights: planned, flown as many at once as there are cores, and gone on with after an interrupt."""
