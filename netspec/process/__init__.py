"""What concerns the whole process: how threads wait, memory that is kept, the garbage collector."""
