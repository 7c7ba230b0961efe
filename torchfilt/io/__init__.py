"""Readers of logs: the only place where units, time scales and frames of files are converted."""
