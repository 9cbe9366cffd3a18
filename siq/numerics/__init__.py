"""What has no physics: integration, random numbers, least squares, text of numbers, whole files."""
