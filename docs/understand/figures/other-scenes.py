import matplotlib.pyplot as plt
import numpy as np

rng = np.random.default_rng(1)
truth = rng.gamma(2.0, size=4000)
x = rng.exponential(truth[:, None], (4000, 4))
one, two = x[:, :2].mean(axis=1), x[:, 2:].mean(axis=1)
models = {
    "a model that fits this scene": lambda m: 0.1 * m + 0.9 * truth.mean(),
    "one that is too bright": lambda m: 0.1 * m + 3 * truth.mean(),
}
weights = np.linspace(0, 1, 50)
fig, axes = plt.subplots(1, 2, figsize=(6.7, 2.2), layout="constrained", sharey=True)
for ax, (name, model) in zip(axes, models.items(), strict=True):
    mean = x.mean(axis=1)
    mse = [((mean + w * (model(mean) - mean) - truth) ** 2).mean() for w in weights]
    ax.plot(weights, np.array(mse) / mse[0], color="#0072B2")
    step = model(one) - one
    a = np.clip((step * (two - one)).sum() / (step**2).sum(), 0, 1)
    ax.axvline(a / (2 - a), color="#D55E00", linestyle="--", label="what the halves choose")
    ax.set(title=name, xlabel="weight of the model", ylim=(0.4, 1.6))
axes[0].set_ylabel("MSE over that of the mean")
axes[1].legend()
fig
