"""Problems with known answers, or with two statements that judge each other; tests and measurements share them."""
