/** The words of the page in tests: those of the service (`make docs` writes them). */

import words from "./words.json";

export const TABLES = words;
