import socket, sys
def refuse(*arguments, **options):
    print("looked up", arguments, flush=True)
    raise OSError
socket.getaddrinfo = socket.create_connection = socket.gethostbyname = socket.socket.connect = refuse
import netspec
net = netspec.load_net(sys.argv[1], engine=sys.argv[2], cache=sys.argv[3])
net(__import__("numpy").zeros((1, 1, 4, 4), "float32"))
assert sys.argv[2] in sys.modules and "openvino_telemetry" not in sys.modules
assert "ORT_DISABLE_TELEMETRY" not in __import__("os").environ
