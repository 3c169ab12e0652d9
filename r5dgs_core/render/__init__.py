"""Render a posed `Scene`: whole pictures, incremental frames, coverage, highlights and viewpoints."""
