"""How the network learns: from random furnished rooms that the simulator writes (``covrecon train``)."""
