"""Options of the commands: groups that Python shares, values as text, former spellings, and files that hold options."""
