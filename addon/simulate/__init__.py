"""Building scenes and photographing them: simulated captures with exact labels, depth and poses."""
