"""UI helpers shared by operators and panels: stepwise operators, status bar, plural forms and worker status."""
