"""The page of live steering in the browser: scene, panel, colours, and the server behind them."""
