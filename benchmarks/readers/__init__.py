"""What other programs read of the files that a2tg convert writes."""
