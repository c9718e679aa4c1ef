"""``covrecon doctor``: whether this computer can fly a mission, and what to do where it cannot.

Each module looks at one thing and returns findings; none changes anything.
"""
