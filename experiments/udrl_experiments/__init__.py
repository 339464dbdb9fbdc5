"""The paper's studies (sections 3.2 to 3.5, Appendix B): ``udrl study NAME``."""
