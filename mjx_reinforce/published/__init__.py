"""Learners: from episodes to better parameters."""
