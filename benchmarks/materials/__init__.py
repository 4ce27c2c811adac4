"""Objects of known materials under known lights: what a method says of both, against the truth, judged by Mitsuba."""
