"""RNN, LSTM and LSTMUnit compared with plain loops in numpy, and how they keep the hidden state."""

import numpy as np
import pytest
import torch

T, N, INPUTS, STATIC, D = 4, 2, 3, 5, 6
PARAM = (
    f"recurrent_param {{ num_output: {D} expose_hidden: %s "
    'weight_filler { type: "gaussian" std: 0.5 } bias_filler { type: "gaussian" std: 0.5 } }'
)


def text(kind: str, expose: bool = False) -> str:
    return f'type: "{kind}" ' + PARAM % str(expose).lower()


def number_of_states(kind: str) -> int:
    return {"RNN": 1, "LSTM": 2}[kind]


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def unroll(kind: str, blobs: list, x: np.ndarray, cont: np.ndarray, state: list, static: np.ndarray | None) -> tuple:
    """Return the outputs of all time steps and the last state; the blobs in Caffe's order."""
    w_x, b, *blobs = blobs
    from_static = 0 if static is None else static.reshape(len(static), -1) @ blobs.pop(0).T
    w_h, *out = blobs
    outputs = []
    for step, keep in zip(x, cont, strict=True):
        keep = keep[:, None]
        z = step.reshape(len(keep), -1) @ w_x.T + b + (keep * state[0]) @ w_h.T + from_static
        if kind == "RNN":
            state = [np.tanh(z)]
            outputs.append(np.tanh(state[0] @ out[0].T + out[1]))
        else:
            i, f, o, g = (z[:, k * D : (k + 1) * D] for k in range(4))
            c = keep * sigmoid(f) * state[1] + sigmoid(i) * np.tanh(g)
            state = [sigmoid(o) * np.tanh(c), c]
            outputs.append(state[0])
    return np.stack(outputs), state


def blobs_of(layer) -> list:
    return [blob.detach().double().numpy() for blob in layer.blobs]


def zeros(kind: str) -> list:
    return [np.zeros((N, D))] * number_of_states(kind)


def random_values(*shape: int) -> np.ndarray:
    return torch.randn(shape).double().numpy()


@pytest.mark.parametrize("kind", ["RNN", "LSTM"])
@pytest.mark.parametrize("with_static", [False, True], ids=["without_static", "with_static"])
def test_rnn_and_lstm_compute_their_formulas(build, kind: str, with_static: bool) -> None:
    shapes = [(T, N, INPUTS, 2), (T, N), *([(N, STATIC)] if with_static else [])]
    layer = build(text(kind), *shapes)
    x, cont = random_values(*shapes[0]), np.array([[0, 0], [1, 1], [1, 0], [1, 1]])
    static = random_values(N, STATIC) if with_static else None
    bottoms = [x, cont, *([static] if with_static else [])]
    found = layer.run(*(torch.tensor(b).float() for b in bottoms))
    expected, _ = unroll(kind, blobs_of(layer), x, cont, zeros(kind), static)
    assert layer.top_shapes == [(T, N, D)]
    np.testing.assert_allclose(found[0].detach().numpy(), expected, atol=1e-5)


def test_blobs_are_in_caffes_order(build) -> None:
    shapes = [(T, N, INPUTS), (T, N), (N, STATIC)]
    assert build(text("LSTM"), *shapes[:2]).blob_shapes == [(4 * D, INPUTS), (4 * D,), (4 * D, D)]
    assert build(text("LSTM"), *shapes).blob_shapes == [(4 * D, INPUTS), (4 * D,), (4 * D, STATIC), (4 * D, D)]
    assert build(text("RNN"), *shapes[:2]).blob_shapes == [(D, INPUTS), (D,), (D, D), (D, D), (D,)]
    assert build(text("RNN"), *shapes).blob_shapes == [(D, INPUTS), (D,), (D, STATIC), (D, D), (D, D), (D,)]


def test_multiply_adds_count_each_matrix_in_each_time_step(build) -> None:
    shapes = [(T, N, INPUTS), (T, N), (N, STATIC)]
    assert build(text("LSTM"), *shapes[:2]).multiply_adds() == T * N * 4 * D * (INPUTS + D)
    assert build(text("RNN"), *shapes).multiply_adds() == N * D * (T * (INPUTS + D + D) + STATIC)


@pytest.mark.parametrize("kind", ["RNN", "LSTM"])
def test_hidden_state_continues_in_the_next_batch(build, kind: str) -> None:
    layer = build(text(kind), (T, N, INPUTS), (T, N))
    x, cont = random_values(2 * T, N, INPUTS), np.ones((2 * T, N))
    cont[T, 1] = 0  # the second stream begins anew with the second batch
    expected, _ = unroll(kind, blobs_of(layer), x, cont, zeros(kind), None)
    for part in (slice(0, T), slice(T, 2 * T)):
        found = layer.run(torch.tensor(x[part]).float(), torch.tensor(cont[part]).float())[0]
        np.testing.assert_allclose(found.detach().numpy(), expected[part], atol=1e-5)
    found.sum().backward()  # reaches back to this batch's beginning only


@pytest.mark.parametrize("kind", ["RNN", "LSTM"])
def test_hidden_state_is_reset_when_the_number_of_streams_changes(build, kind: str) -> None:
    layer = build(text(kind), (T, N, INPUTS), (T, N))
    layer.run(torch.randn(T, N, INPUTS), torch.ones(T, N))
    x = random_values(T + 1, N + 1, INPUTS)  # more time steps, too
    found = layer.run(torch.tensor(x).float(), torch.ones(T + 1, N + 1))[0]
    start = [np.zeros((N + 1, D))] * number_of_states(kind)
    expected, _ = unroll(kind, blobs_of(layer), x, np.ones((T + 1, N + 1)), start, None)
    np.testing.assert_allclose(found.detach().numpy(), expected, atol=1e-5)


@pytest.mark.parametrize("kind", ["RNN", "LSTM"])
@pytest.mark.parametrize("with_static", [False, True], ids=["without_static", "with_static"])
def test_expose_hidden_makes_the_state_bottoms_and_tops_without_gradient(build, kind: str, with_static: bool) -> None:
    state_shapes = [(1, N, D)] * number_of_states(kind)
    static_shape = [(N, STATIC)] if with_static else []
    layer = build(
        text(kind, True), (T, N, INPUTS), (T, N), *static_shape, *state_shapes, tops=1 + number_of_states(kind)
    )
    assert layer.top_shapes == [(T, N, D), *state_shapes]
    x, cont, start = random_values(T, N, INPUTS), np.ones((T, N)), [random_values(N, D) for _ in state_shapes]
    static = random_values(N, STATIC) if with_static else None
    given = [torch.tensor(s[None]).float().requires_grad_() for s in start]
    middle = [torch.tensor(static).float()] if with_static else []
    for _ in range(2):  # the second pass starts from the given state too
        found = layer.run(torch.tensor(x).float(), torch.tensor(cont).float(), *middle, *given)
    expected, last = unroll(kind, blobs_of(layer), x, cont, start, static)
    np.testing.assert_allclose(found[0].detach().numpy(), expected, atol=1e-5)
    for top, state in zip(found[1:], last, strict=True):
        np.testing.assert_allclose(top.detach().numpy(), state[None], atol=1e-5)
        assert not top.requires_grad
    found[0].sum().backward()
    assert [s.grad for s in given] == [None] * number_of_states(kind)


# LSTMUnit


def test_lstm_unit_has_gates_in_the_order_i_f_o_g_and_cont_zero_forgets_the_cell(build) -> None:
    layer = build('type: "LSTMUnit"', (1, N, D), (1, N, 4 * D), (1, N), tops=2)
    assert layer.top_shapes == [(1, N, D)] * 2
    cell, gates, cont = random_values(1, N, D), random_values(1, N, 4 * D), np.array([[1.0, 0.0]])
    c, h = layer.run(*(torch.tensor(b).float() for b in (cell, gates, cont)))
    i, f, o, g = np.split(gates, 4, 2)
    expected = cont[:, :, None] * sigmoid(f) * cell + sigmoid(i) * np.tanh(g)
    np.testing.assert_allclose(c.numpy(), expected, atol=1e-6)
    np.testing.assert_allclose(h.numpy(), sigmoid(o) * np.tanh(expected), atol=1e-6)
