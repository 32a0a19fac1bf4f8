"""The results of a run for people: its page, maps, pictures and statistics."""
