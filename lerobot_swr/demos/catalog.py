"""All dataset recipes of the package, by name."""

from lerobot_swr.demos.d3il_aligning import ALIGNING_RECIPES
from lerobot_swr.demos.d3il_avoiding import AVOIDING_RECIPES
from lerobot_swr.demos.maze2d import MAZE_RECIPES
from lerobot_swr.demos.recipe import DatasetRecipe

RECIPES: dict[str, DatasetRecipe] = {
    recipe.name: recipe for recipe in (*MAZE_RECIPES, *AVOIDING_RECIPES, *ALIGNING_RECIPES)
}


def get_recipe(name: str) -> DatasetRecipe:
    """The recipe called `name`.

    Raises:
        ValueError: If there is no such recipe.
    """
    if name not in RECIPES:
        raise ValueError(f"task={name!r}: unknown dataset; known datasets: {', '.join(RECIPES)}")
    return RECIPES[name]
