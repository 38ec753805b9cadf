"""What is missing: candidates, claims, places, lines, and the verbs compare, diagnose, improve."""
