// What the 3D view uses of Spark; `make vendor` bundles it into spark.min.js, which takes three.js from three.min.js.
export { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
