"""What was flown and mapped, in the formats of other programs: made from a run's folder or from a recording alone."""
