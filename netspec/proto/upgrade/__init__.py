"""From every older form of nets and solvers to the current one."""
