"""Where the rows of metrics.csv go besides: JSON lines, TensorBoard, Weights & Biases."""
