"""What many flights come to together: tables, figures and pages of a study, made from its folder alone."""
