"""Makes book/_ext/math.woff2, the font of formulas, from a part of STIX Two Math.

    uv run --with fonttools[woff]==4.68.0 --with ziamath==0.13 environment/font.py

ziamath carries the font, version 2.11, under the SIL Open Font License 1.1.
"""

from importlib.resources import files
from pathlib import Path

from fontTools.pens.recordingPen import DecomposingRecordingPen
from fontTools.pens.transformPen import TransformPen
from fontTools.pens.ttGlyphPen import TTGlyphPen
from fontTools.subset import Options, Subsetter, parse_unicodes
from fontTools.ttLib import TTFont

SOURCE = files("ziamath") / "fonts" / "STIXTwoMath-Regular.ttf"
TARGET = Path(__file__).parents[1] / "book" / "_ext" / "math.woff2"
LETTERS = """
    20-7E,A0,AF,B1,B7,D7,131,237,2C6,2C7,2D8,2D9,2DC,300-304,305,307,308,332,391-3A9,3B1-3C9,3D1,3D5,3F5,
    2016,2026,2032,2033,203E,2061-2064,210B-210E,2110-2113,211B,211C,212C,2130,2131,2133,2190-2194,21A6,21D2,
    2200,2202,2203,2206-2208,220F,2211-2213,2217,2218,221A,221D,221E,2223,2225,2229-222B,223C,2248,2260-2265,
    226A,226B,2282,2286,2295,2297,22A5,22C5,22EE-22F1,2308-230B,27E8,27E9,1D434-1D467,1D49C-1D4B5,1D6A4,1D6A5,
    1D6E2-1D71B,1D7CF,23DE,23DF,FE00
"""
PRIMES = {0x2032: "minute.ssty", 0x2033: "second.ssty"}
RADICAL = 0x221A


def main() -> None:
    """Write the font."""
    font = TTFont(SOURCE, recalcTimestamp=False)
    use_primes_of_scripts(font)
    narrow_radicals(font)
    options = Options(layout_features=[], hinting=False, name_IDs=[0, 1, 2, 3, 5, 13, 14])
    options.drop_tables += ["DSIG", "GDEF", "GPOS", "GSUB", "gasp"]
    subsetter = Subsetter(options)
    subsetter.populate(unicodes=parse_unicodes("".join(LETTERS.split())))
    subsetter.subset(font)
    font.flavor = "woff2"
    font.save(TARGET)


def use_primes_of_scripts(font: TTFont) -> None:
    """Use primes that are drawn for superscripts: Chromium does not choose them there."""
    for table in font["cmap"].tables:
        table.cmap |= PRIMES


def narrow_radicals(font: TTFont) -> None:
    """Make tall radicals as narrow as the lowest one: Chromium keeps room for the widest after each of them."""
    glyphs, widths, variants = font.getGlyphSet(), font["hmtx"], font["MATH"].table.MathVariants
    base = font.getBestCmap()[RADICAL]
    shapes = variants.VertGlyphConstruction[variants.VertGlyphCoverage.glyphs.index(base)]
    names = [record.VariantGlyph for record in shapes.MathGlyphVariantRecord]
    names += [part.glyph for part in shapes.GlyphAssembly.PartRecords]
    width = widths[base][0]
    for name in dict.fromkeys(names):
        outline, narrow = DecomposingRecordingPen(glyphs), TTGlyphPen(None)
        glyphs[name].draw(outline)
        outline.replay(TransformPen(narrow, (width / widths[name][0], 0, 0, 1, 0, 0)))
        font["glyf"][name] = narrow.glyph()
        font["glyf"][name].recalcBounds(font["glyf"])
        widths[name] = width, font["glyf"][name].xMin


if __name__ == "__main__":
    main()
