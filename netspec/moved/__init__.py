"""Old homes of names that users have written into their commands. They stay valid."""
