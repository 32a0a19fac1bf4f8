"""What a run reports about itself: events, log lines, timings, memory, versions."""
