"""Exported glTF files in stock viewers."""
