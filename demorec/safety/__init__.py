"""What keeps the user's files and programs safe from us and from foreign data."""
