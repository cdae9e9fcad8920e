"""Settings: frozen pydantic models; a unit and a meaning per field; unknown keys refused."""

from pydantic import BaseModel, ConfigDict


class Settings(BaseModel):
    """Base of all settings: frozen; an unknown key is an error at every level."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
