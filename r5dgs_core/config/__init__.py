"""Configuration: sections, presets, TOML files and overrides."""
