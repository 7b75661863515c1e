"""Options of the commands: groups that Python shares, values as text, and files that hold options."""
