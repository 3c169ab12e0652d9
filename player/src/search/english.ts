// English text processing, as in r5dgs_core/search/english.py.

const FILLER = new Set("a an the this that these those of in on at my all any".split(" "));
const COUNTS = new Set("both two three four five six seven eight nine ten some few".split(" "));
const PLURALS: Record<string, string> = {
  men: "man", women: "woman", children: "child", people: "person", lives: "life",
  feet: "foot", teeth: "tooth", geese: "goose", mice: "mouse", quizzes: "quiz",
};
for (const word of "gas lens iris canvas atlas potato tomato mango hero".split(" ")) PLURALS[`${word}es`] = word;
const NO_PLURALS = new Set(["gas", "lens", "canvas", "atlas"]);
const PLURAL_ENDINGS: [string, string][] = [
  ..."lea loa el hal cal wol scar hoo thie".split(" ").map((start): [string, string] => [`${start}ves`, `${start}f`]),
  ["knives", "knife"], ["wives", "wife"],
];
const SPLIT = /\s*(?:,|;|\+|&|\/|\band\b|\bor\b|\bplus\b)\s*/i;

export type Phrase = [string, string[]]; // as written, and its words

export const casefold = (text: string): string => text.toLowerCase().replace(/ß/g, "ss").replace(/ς/g, "σ");

export function wordsOf(text: string): string[] {
  const plain = casefold(text.normalize("NFKD").replace(/\p{M}/gu, ""));
  return (plain.match(/[\p{L}\p{N}]+/gu) ?? []).map(singular);
}

export function singular(word: string): string {
  if (Object.hasOwn(PLURALS, word)) return PLURALS[word];
  for (const [plural, one] of PLURAL_ENDINGS) {
    if (word.endsWith(plural)) return word.slice(0, -plural.length) + one;
  }
  if (word.endsWith("s") && !/(ss|us|is)$/.test(word) && !NO_PLURALS.has(word) && [...word].length > 3) {
    word = word.slice(0, -1);
  }
  const size = [...word].length;
  if (size > 3 && word.endsWith("ie")) return `${word.slice(0, -2)}y`;
  if (size > 3 && (/(che|she|xe|sse|ze)$/.test(word) || /[^ao]use$/.test(word))) return word.slice(0, -1);
  return word;
}

export const spaced = (text: string): string => text.trim().split(/\s+/).filter(Boolean).join(" ");

export function phrases(text: string): Phrase[] {
  const result: Phrase[] = [];
  for (const part of spaced(text).split(SPLIT)) {
    const words = wordsOf(part), left = words.filter((word) => !FILLER.has(word));
    let kept = left.length ? left : words;
    while (kept.length > 1 && COUNTS.has(kept[0])) kept = kept.slice(1);
    if (kept.length) result.push([part.trim(), kept]);
  }
  return result;
}
