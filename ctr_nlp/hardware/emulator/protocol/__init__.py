"""What the emulated firmware reads and answers: lines, real-time characters, settings, reports."""
