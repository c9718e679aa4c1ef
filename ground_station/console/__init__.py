"""The page in the browser from which a mission is watched and commanded; its own process, a client of the bus."""
