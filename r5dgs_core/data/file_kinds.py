"""Kinds of files by suffix, lower case. Needs only the standard library, for the detection of layouts."""

from __future__ import annotations

IMAGES = (".png", ".jpg", ".jpeg", ".exr", ".webp", ".tif", ".tiff")
HEIC = (".heic", ".heif")
UNREADABLE = (*HEIC, ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".gif", ".bmp", ".psd")
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv", ".mts", ".m2ts", ".ts")
