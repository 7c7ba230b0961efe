"""Whole tasks made of the library's parts: data, learned dynamics, filters, figures and numbers."""
