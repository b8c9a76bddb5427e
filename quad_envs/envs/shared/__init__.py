"""What the environments of one vehicle and of teams share."""
