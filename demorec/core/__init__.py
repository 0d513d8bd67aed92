"""What everything else stands on: errors, numbers, tables, and what keeps the user's files and programs safe."""
