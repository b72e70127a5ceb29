"""What a rollout is compared with: particle paths, surfaces, silhouettes and colors."""
