import sys
import netspec.pycaffe as caffe
rank, uid = int(sys.argv[1]), sys.argv[2]
caffe.set_solver_count(2)
caffe.set_solver_rank(rank)
caffe.set_multiprocess(True)
caffe.set_random_seed(rank)
assert (caffe.solver_count(), caffe.solver_rank()) == (2, rank)
solver = caffe.SGDSolver("solver.prototxt")
nccl = caffe.NCCL(solver, uid)
nccl.bcast()
solver.add_callback(nccl)
solver.step(2)
print(repr(solver.net.params["fc"][0].data.tolist()))
