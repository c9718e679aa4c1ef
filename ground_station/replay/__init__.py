"""A flight's phi and map made again from its recording: the same to the last bit, or with other settings to compare."""
