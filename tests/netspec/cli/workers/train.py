import netspec

solver = netspec.load_solver("solver.prototxt", allow_python=True)
solver.solve()
print("iterations", solver.iteration)
