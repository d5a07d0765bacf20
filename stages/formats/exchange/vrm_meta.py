"""What avatar.vrm says about itself and about who may do what with it, in the words of VRM 1.0.

https://github.com/vrm-c/vrm-specification/blob/master/specification/VRMC_vrm-1.0/meta.md
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from stages.contract import Params

Text = Annotated[str, Field(min_length=1)]
LICENCE = "https://vrm.dev/licenses/1.0/"


class VrmMeta(Params):
    """The fields of a VRM's meta; those that are not given allow the least."""

    name: Text = "avatar"
    version: str = ""
    authors: Annotated[tuple[Text, ...], Field(min_length=1)] = ("unknown",)
    copyright_information: str = ""
    contact_information: str = ""
    avatar_permission: Literal["onlyAuthor", "onlySeparatelyLicensedPerson", "everyone"] = "onlyAuthor"
    commercial_usage: Literal["personalNonProfit", "personalProfit", "corporation"] = "personalNonProfit"
    credit_notation: Literal["required", "unnecessary"] = "required"
    modification: Literal["prohibited", "allowModification", "allowModificationRedistribution"] = "prohibited"
    allow_redistribution: bool = False
    allow_excessively_violent_usage: bool = False
    allow_excessively_sexual_usage: bool = False
    allow_political_or_religious_usage: bool = False
    allow_antisocial_or_hate_usage: bool = False
    other_license_url: str = ""

    def as_written(self) -> dict[str, Any]:
        """As the file has them: without empty ones."""
        found: dict[str, Any] = {"licenseUrl": LICENCE}
        for name, value in self.model_dump(mode="json").items():
            first, *rest = name.split("_")
            if value != "":
                found[first + "".join(word.title() for word in rest)] = value
        return found
