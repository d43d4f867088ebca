"""Programs that exchange plans with other programs: shapes for viewers, configurations from elsewhere."""
