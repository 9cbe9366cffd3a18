"""Recordings: read from files, checked, inspected, selected."""
