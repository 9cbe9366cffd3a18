"""Concealed cases: recordings whose simulation lacks something, and keys; knows nothing of siq."""
