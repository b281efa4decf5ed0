"""What a user sees of a program: its commands, log and exit status. The ground of netspec and loopclosure."""
