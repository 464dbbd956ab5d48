"""Shared by the tests of recurrent cores that have kernels."""

import torch


def assert_close(names, results, expected, slack):
    """Compares tensors with a tolerance of `slack` times their largest magnitude."""
    for name, tensor, expected_tensor in zip(names, results, expected, strict=True):
        torch.testing.assert_close(
            *(tensor, expected_tensor),
            rtol=0,
            atol=slack * expected_tensor.abs().max().item(),
            msg=lambda text, name=name: f"{name}: {text}",
        )


def check_captured(core, last, slack, bf16):
    """Checks on a GPU that a captured unroll and its gradients match an eager unroll and steps.

    Inputs, resets and hidden state change after the capture.

    Args:
        core: the recurrent core.
        last: leaf of the hidden state that the loss depends on.
        slack: tolerance, as for `assert_close`.
        bf16: whether to use autocast.
    """
    torch.manual_seed(0)
    n_steps, n_lanes, core = 9, 64, core.cuda()
    x = torch.randn(n_steps, n_lanes, core.width, device="cuda", requires_grad=True)
    reset = torch.rand(n_steps, n_lanes, device="cuda") < 0.3
    state = core.initial(n_lanes, "cuda")
    inputs = [x, *core.parameters()]

    def unroll():
        with torch.autocast("cuda", torch.bfloat16, enabled=bf16):
            outputs, after = core(x, reset, state)
        loss = outputs.float().square().sum() + after[last].sum()
        return [outputs, after[last], *torch.autograd.grad(loss, inputs)]

    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        unroll()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = unroll()
    with torch.no_grad():
        for tensor in (x, *state.values()):
            tensor.normal_()
        reset.copy_(torch.rand(n_steps, n_lanes, device="cuda") < 0.3)
    graph.replay()
    captured, expected = ([leaf.float() for leaf in leaves] for leaves in (captured, unroll()))
    names = "outputs", last, "d x", *(f"d {name}" for name, _ in core.named_parameters())
    assert_close(names, captured, expected, slack)
    atol = slack * max(1.0, captured[0].abs().max().item())
    with torch.no_grad(), torch.autocast("cuda", torch.bfloat16, enabled=bf16):
        for t in range(n_steps):
            output, state = core(x[t : t + 1], reset[t : t + 1], state)
            torch.testing.assert_close(output[0].float(), captured[0][t], rtol=0, atol=atol)
