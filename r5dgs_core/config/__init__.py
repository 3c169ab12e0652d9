"""Configuration: sections, presets, TOML files, overrides and the user's settings."""
