"""The workflow: rules, scripts, and what the rules know of the configuration."""
