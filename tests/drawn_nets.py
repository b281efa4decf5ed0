"""Random nets that learn."""

import random
from dataclasses import dataclass, field

W = 'weight_filler { type: "xavier" } bias_filler { type: "uniform" min: -0.5 max: 0.5 }'
# What a layer of one bottom does to its shape: nothing, in place too; or what a pass finds out.
POINTWISE = [
    'type: "ReLU"',
    'type: "ReLU" relu_param { negative_slope: 0.1 }',
    'type: "PReLU"',
    'type: "ELU"',
    'type: "Sigmoid"',
    'type: "TanH"',
    'type: "Swish" swish_param { beta: 1.5 }',
    'type: "Dropout" dropout_param { dropout_ratio: 0.3 }',
    'type: "BatchNorm"',
    'type: "BatchNorm" propagate_down: false',
    'type: "Scale" scale_param { bias_term: true filler { type: "uniform" min: 0.5 max: 1.5 } }',
    'type: "Bias" bias_param { filler { type: "uniform" } }',
    'type: "Softmax"',
    'type: "Exp" exp_param { scale: 0.3 }',
]
OTHERS = [
    'type: "BNLL"',
    'type: "AbsVal"',
    'type: "Clip" clip_param { min: -0.7 max: 0.9 }',
    'type: "Power" power_param { power: 2 scale: 0.7 shift: 0.3 }',
    'type: "Power" power_param { scale: 0.7 shift: 0.3 }',
    'type: "MVN"',
    'type: "Flatten"',
    'type: "Tile" tile_param { tiles: 2 }',
    'type: "Reshape" reshape_param { shape { dim: 0 dim: -1 } }',
    f'type: "InnerProduct" inner_product_param {{ num_output: 5 {W} }}',
    f'type: "InnerProduct" inner_product_param {{ num_output: 4 {W} }} param {{ lr_mult: 0 }}',
]
MAPS = [
    'type: "LRN" lrn_param { local_size: 3 }',
    'type: "LRN" lrn_param { local_size: 3 norm_region: WITHIN_CHANNEL }',
    'type: "MVN" mvn_param { across_channels: true }',
    'type: "SPP" spp_param { pyramid_height: 2 }',
]


@dataclass
class Drawn:
    """A net as it grows: its text, and the blobs that can be read, with their shapes."""

    draw: random.Random
    images: int = 1
    text: list[str] = field(default_factory=list)
    blobs: list[str] = field(default_factory=list)

    def add(self, settings: str, bottoms: list[str], tops: list[str] | None = None) -> str:
        name = f"l{len(self.text)}"
        tops = tops or [name]
        ends = "".join(f' bottom: "{b}"' for b in bottoms) + "".join(f' top: "{t}"' for t in tops)
        self.text.append(f'layer {{ name: "{name}" {settings}{ends} }}')
        self.blobs += [top for top in tops if top not in self.blobs]
        return tops[0]

    def window(self) -> str:
        """Return a filter's settings, odd ones too: longer steps than filters, filters of one pixel, wide padding."""
        kernel, stride = self.draw.choice([1, 1, 2, 3]), self.draw.choice([1, 1, 2, 3])
        return f"kernel_size: {kernel} stride: {stride} pad: {self.draw.randrange(kernel)}"

    def shared(self, blob: str, maps: bool) -> tuple[str, bool]:
        """Add two layers that share their blobs: of a Scale, or recurrent ones over the images as steps in time."""
        own, kind = f"p{len(self.text)}", "Scale" if maps else self.draw.choice(["Scale", "LSTM", "RNN"])
        params = " ".join(f'param {{ name: "{own}{k}" }}' for k in range({"Scale": 2, "LSTM": 3, "RNN": 5}[kind]))
        fields = 'scale_param { bias_term: true filler { type: "uniform" min: 0.5 } }'
        more = []
        if kind != "Scale":
            blob = self.add('type: "Reshape" reshape_param { shape { dim: 0 dim: 1 dim: -1 } }', [blob])
            filled = f"shape {{ dim: {self.images} dim: 1 }} data_filler {{ value: 1 }}"
            more = [self.add(f'type: "DummyData" dummy_data_param {{ {filled} }}', [])]
            fields = f"recurrent_param {{ num_output: 3 {W} }}"
        blobs = blob, self.add('type: "AbsVal"', [blob])
        top = self.add('type: "Eltwise"', [self.add(f'type: "{kind}" {params} {fields}', [b, *more]) for b in blobs])
        return (self.add('type: "Reshape" reshape_param { shape { dim: 0 dim: -1 } }', [top]) if more else top), maps

    def step(self, blob: str, maps: bool) -> tuple[str, bool]:
        """Add a layer on a blob; return its top, and whether that has maps."""
        draw, kind = self.draw, self.draw.random()
        if draw.random() < 0.15:  # changed in place, then read twice
            if draw.random() < 0.3:  # and read before
                blob = self.add('type: "Eltwise"', [blob, self.add(draw.choice(POINTWISE), [blob])])
            self.add(draw.choice(POINTWISE), [blob], [blob])
            readers = [self.add(draw.choice([*POINTWISE, *OTHERS[:6]]), [blob]) for _ in range(2)]
            return self.add('type: "Eltwise"', readers), maps
        if draw.random() < 0.08:
            return self.shared(blob, maps)
        if kind < 0.35:
            return self.add(draw.choice(POINTWISE), [blob], [blob] if draw.random() < 0.6 else None), maps
        if kind < 0.5:
            settings = draw.choice(OTHERS)
            return self.add(settings, [blob]), maps and not any(t in settings for t in ("Flatten", "Reshape", "Inner"))
        if kind < 0.6:
            other = self.add(draw.choice(POINTWISE[:7]), [blob])
            joined = draw.choice(
                [
                    'type: "Eltwise"',
                    'type: "Eltwise" eltwise_param { operation: PROD }',
                    'type: "Eltwise" eltwise_param { operation: MAX }',
                    'type: "Concat"',
                ]
            )
            return self.add(joined, [blob, other]), maps
        if kind < 0.68:
            axis = draw.choice([1, 2, 3]) if maps else 0
            one, two = f"s{len(self.text)}", f"t{len(self.text)}"
            self.add(f'type: "Slice" slice_param {{ axis: {axis} }}', [blob], [one, two])
            first, second = (self.add(draw.choice([*POINTWISE, *OTHERS[:6]]), [b]) for b in (one, two))
            return self.add(f'type: "Concat" concat_param {{ axis: {axis} }}', [first, second]), maps
        if not maps:
            return self.add(f'type: "InnerProduct" inner_product_param {{ num_output: 6 {W} }}', [blob]), False
        if kind < 0.8:
            pool = draw.choice(["MAX", "AVE"])
            return self.add(f'type: "Pooling" pooling_param {{ pool: {pool} {self.window()} }}', [blob]), True
        if kind < 0.85:
            settings = draw.choice(MAPS)
            return self.add(settings, [blob]), "SPP" not in settings
        if kind < 0.9:
            settings = f"num_output: 4 kernel_size: 2 stride: {draw.choice([1, 2])} {W}"
            return self.add(f'type: "Deconvolution" convolution_param {{ {settings} }}', [blob]), True
        settings = f"num_output: 4 group: {draw.choice([1, 2])} dilation: {draw.choice([1, 2])} {self.window()} {W}"
        return self.add(f'type: "Convolution" convolution_param {{ {settings} }}', [blob]), True


def drawn(seed: int) -> str:
    """Return a net that learns: data, a first layer that learns, a few more, and a loss or two."""
    net = Drawn(random.Random(seed))
    images, sizes = net.draw.choice([1, 1, 2, 4]), net.draw.choice(["4 6 6", "4 6 2", "4 1 6", "6"]).split()
    shape = " ".join(f"dim: {size}" for size in (images, *sizes))
    net.images, maps = images, len(sizes) == 3
    head = "force_backward: true\n" if net.draw.random() < 0.3 else ""
    data = f'shape {{ {shape} }} data_filler {{ type: "gaussian" }}'
    net.text.append(f'layer {{ name: "x" type: "DummyData" top: "x" dummy_data_param {{ {data} }} }}')
    first = f'type: "Convolution" convolution_param {{ num_output: 4 kernel_size: 1 {W} }}'
    blob = net.add(first if maps else f'type: "InnerProduct" inner_product_param {{ num_output: 4 {W} }}', ["x"])
    for _ in range(net.draw.randint(1, 6)):
        blob, maps = net.step(blob, maps)
    end = net.add(f'type: "InnerProduct" inner_product_param {{ num_output: 3 {W} }}', [blob])
    operation = net.draw.choice(["SUMSQ", "SUM", "ASUM", "MEAN"])
    net.add(f'type: "Reduction" reduction_param {{ operation: {operation} }} loss_weight: 0.5', [end])
    if net.draw.random() < 0.3:
        net.add('type: "Reduction" reduction_param { operation: SUMSQ } loss_weight: 0.1', [blob])
    if net.draw.random() < 0.3:  # a loss that is read again
        weight = net.draw.choice(["", "loss_weight: 0.7", "loss_weight: 0"])
        loss = net.add(f'type: "EuclideanLoss" {weight}', [end, net.add('type: "Sigmoid"', [end])])
        for _ in range(net.draw.randint(1, 2)):
            weight = net.draw.choice(["", "loss_weight: 0.2"])
            net.add(f'type: "Power" power_param {{ scale: 2 }} {weight}', [loss])
        if net.draw.random() < 0.2:
            net.text.append(f'layer {{ name: "silence" type: "Silence" bottom: "{loss}" }}')
    return head + "\n".join(net.text) + "\n"
