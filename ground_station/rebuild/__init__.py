"""A flight's map made anew from its keyframes, afterwards and as well as one likes: ``covrecon reconstruct``."""
