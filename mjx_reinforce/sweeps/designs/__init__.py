"""What a sweep is to do: configurations, searches, groups, and their division into chunks."""
