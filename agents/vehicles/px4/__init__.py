"""PX4 autopilots, flown through MAVSDK."""
