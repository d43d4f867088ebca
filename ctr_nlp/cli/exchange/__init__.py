"""Programs that exchange plans with other programs: shapes for viewers, configurations to be judged."""
