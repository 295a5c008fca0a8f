"""A NEXTAGE-like dual-arm robot: its joints, what it can reach, and how it moves for a gesture."""
