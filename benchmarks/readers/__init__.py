"""Files of `a2tg convert`, read by other programs."""
