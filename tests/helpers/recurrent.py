"""What tests of recurrent cores with kernels of their own share."""

import torch


def assert_close(names, found, expected, slack):
    """Arrays agree, each element to a share of its array's greatest magnitude."""
    for name, ours, theirs in zip(names, found, expected, strict=True):
        torch.testing.assert_close(
            *(ours, theirs),
            rtol=0,
            atol=slack * theirs.abs().max().item(),
            msg=lambda text, name=name: f"{name}: {text}",
        )


def check_captured(core, last, step, slack, bf16, n_steps=9, n_lanes=64):
    """On a GPU a captured graph of a core's unrolling, gradients included, gives what unrolling and
    stepping do, with inputs, resets and a state that were changed after the capture.

    `last` is the leaf of the state that the loss depends on; `step` takes x (B, W), reset (B,) and
    a state, and returns the output and the next state.
    """
    torch.manual_seed(0)
    core = core.cuda()
    x = torch.randn(n_steps, n_lanes, core.width, device="cuda", requires_grad=True)
    reset = torch.rand(n_steps, n_lanes, device="cuda") < 0.3
    state = core.initial(n_lanes, "cuda")
    wanted = [x, *core.parameters()]

    def unroll():
        with torch.autocast("cuda", torch.bfloat16, enabled=bf16):
            outputs, after = core(x, reset, state)
        loss = outputs.float().square().sum() + after[last].sum()
        return [outputs, after[last], *torch.autograd.grad(loss, wanted)]

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
            output, state = step(x[t], reset[t], state)
            torch.testing.assert_close(output.float(), captured[0][t], rtol=0, atol=atol)
