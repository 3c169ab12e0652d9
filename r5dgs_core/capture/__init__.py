"""Real captures: calibrations, lenses, and what `r5dgs prepare` makes of videos."""
