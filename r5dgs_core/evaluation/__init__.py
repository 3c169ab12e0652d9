"""Evaluation of a scene against its data set: metrics, tables, legend and contact sheet."""
