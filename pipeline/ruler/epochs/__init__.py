"""Two epochs of one place compared: which buildings are new, gone, raised, lowered, reshaped, unchanged."""
