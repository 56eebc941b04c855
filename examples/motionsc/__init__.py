"""MotionSC: semantic scene completion in dynamic environments (Wilson et al., RA-L 2022)."""
