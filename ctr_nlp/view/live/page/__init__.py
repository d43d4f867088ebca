"""What the browser shows of live steering: scene, panel, colours, and the server behind them."""
