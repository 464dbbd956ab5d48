"""Takes a trained agent out of megastep: ONNX, torch.export, an agent file, a web page."""
