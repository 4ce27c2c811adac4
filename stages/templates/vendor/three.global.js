// In place of the package "three" where Spark is bundled: the one that the page has already.
module.exports = globalThis.THREE;
