"""How good a map is, in figures, thing by thing, and as a picture: what ``covrecon evaluate`` says."""
