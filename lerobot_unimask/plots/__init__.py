"""Pictures of answers: each function makes one matplotlib Figure, without pyplot, so no display or backend is needed.

Colours are those of Okabe and Ito (2008), which colour-blind readers can tell apart; time runs along viridis. Figures
are 9 inches wide: saved with `figure.savefig(path, dpi=200)` they read well at 900 pixels.
"""
