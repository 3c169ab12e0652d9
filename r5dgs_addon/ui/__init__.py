"""Parts shared by operators and panels: stepwise operators, status bar and plurals."""
