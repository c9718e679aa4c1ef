"""One file that holds a flight: written by the ground station as it goes, read by replay, report and exports."""
