"""Online reinforcement learning over pre-trained skills (section 5.3): the environment of skills, and SAC in it."""
