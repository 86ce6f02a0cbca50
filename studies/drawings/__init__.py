"""The paper's explanatory figures."""
