"""Made-up scenes whose surface and cameras are known: the demo's, and what the synthetic suite shares with it."""
