"""The text of the classes that ``python -m mjx_reinforce.new`` writes."""
