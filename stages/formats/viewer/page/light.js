// A picture of half floats, in which many faint layers add up to what they should; a canvas rounds each of them to a byte.
import { HalfFloatType, ShaderMaterial, SRGBColorSpace, WebGLRenderTarget } from "three";
import { FullScreenQuad } from "three/addons/postprocessing/Pass.js";

const CORNERS = "void main() { gl_Position = vec4(position.xy, 1.0, 1.0); }";
const COPY = "uniform sampler2D picture; void main() { gl_FragColor = texelFetch(picture, ivec2(gl_FragCoord.xy), 0); }";

export class Light {
  constructor(renderer) {
    this.renderer = renderer;
    const { extensions } = renderer;
    this.target = null; // where the graphics card cannot draw half floats
    if (!extensions.has("EXT_color_buffer_float") && !extensions.has("EXT_color_buffer_half_float")) return;
    this.target = new WebGLRenderTarget(1, 1, { type: HalfFloatType, colorSpace: SRGBColorSpace });
    this.target.isXRRenderTarget = true; // by this three.js and Spark keep the display's colours, as on a canvas
    const uniforms = { picture: { value: this.target.texture } };
    this.copy = new FullScreenQuad(new ShaderMaterial({ uniforms, vertexShader: CORNERS, fragmentShader: COPY, depthTest: false }));
  }

  /** Draw a scene onto the canvas. */
  paint(scene, camera) {
    const { renderer, target } = this, { width, height } = renderer.domElement;
    if (!target) return renderer.render(scene, camera);
    if (target.width !== width || target.height !== height) target.setSize(width, height);
    renderer.setRenderTarget(target);
    renderer.render(scene, camera);
    renderer.setRenderTarget(null);
    this.copy.render(renderer);
  }
}
